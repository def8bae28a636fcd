"""The commands, one file each: arguments in, text out. What they do is in the modules beside this package."""
