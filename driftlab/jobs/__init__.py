"""What each command does, as a function that leaves a folder of results."""
