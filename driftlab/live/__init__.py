"""A live run: its status, its history, its page, and the map that grows meanwhile."""
