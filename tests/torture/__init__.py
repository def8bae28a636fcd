"""A campaign of bad input, kills and full disks: `python tests/torture/campaign.py`."""
