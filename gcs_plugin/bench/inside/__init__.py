"""Scripts that run inside the environments of other programs; they import nothing of this one."""
