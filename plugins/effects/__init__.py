"""Physical effects that a residual can be traced to, one file each."""
