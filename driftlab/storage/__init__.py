"""Output: folders that are whole or absent, locks, map files and HDF5 files that grow."""
