"""Where recordings come from, one file each."""
