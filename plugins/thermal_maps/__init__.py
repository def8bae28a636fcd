"""Maps from temperature to bias, one file each."""
