"""Every environment as data."""
