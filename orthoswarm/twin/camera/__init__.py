"""What a simulated camera makes of the ground: ray marching, sensor, EXIF and XMP tags."""
