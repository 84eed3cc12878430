"""Drop a matcher here."""
