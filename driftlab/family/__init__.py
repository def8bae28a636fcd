"""Mixed model of the units of one type: their maps as draws from one law, outliers, and effects that they share."""
