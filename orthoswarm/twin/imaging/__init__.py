"""The simulated camera: rendering by ray marching, sensor model, EXIF and XMP tags."""
