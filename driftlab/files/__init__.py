"""What is written: folders that are whole or not there, locks, HDF5 files that grow."""
