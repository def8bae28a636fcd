"""How devices put samples into bytes, one file each."""
