"""What units of one type have in common: their maps as draws from one law, and what follows for each unit."""
