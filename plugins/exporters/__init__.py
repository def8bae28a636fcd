"""Forms in which a fitted map leaves for other programs, one file each."""
