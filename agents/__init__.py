"""Trigger policies. Used from a checkout; the wheel ships ``nl_env`` alone."""
