"""Scripts that run in the virtual environments of other programs; they import nothing from this one."""
