"""Which chamber profile tells most of a unit's map, before anything is recorded."""
