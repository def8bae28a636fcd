"""A first config of an unknown file: channels by the names of its columns, units and noise by their values."""
