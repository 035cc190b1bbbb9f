"""Metadata inside and beside videos: SEI, KLV, djmd, subtitles."""
