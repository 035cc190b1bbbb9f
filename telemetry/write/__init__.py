"""Poses written into pictures (EXIF, XMP) and video (SEI)."""
