"""Cases of the loop's benchmark: recordings, what is in them, and what a good answer is."""
