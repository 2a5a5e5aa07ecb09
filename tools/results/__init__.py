"""The results of a run in Python and in tables; fit of one surface in memory."""
