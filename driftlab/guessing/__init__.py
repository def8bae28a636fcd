"""What an unknown file probably holds: channels by the names of its columns, units and noise by their values."""
