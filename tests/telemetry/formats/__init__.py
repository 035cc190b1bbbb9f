"""Readers of single formats: logs, tags, tables, metadata in videos."""
