"""Metadata inside picture files: containers, EXIF, XMP, maker notes."""
