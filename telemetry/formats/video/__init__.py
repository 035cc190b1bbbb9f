"""Metadata in videos and next to them: SEI, KLV, djmd, subtitles."""
