"""The compiled kernels of the real-time module and the renderer, and the plain arrays that they take."""
