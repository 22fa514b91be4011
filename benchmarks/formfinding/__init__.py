"""Form-finding measured, one module for each question; see ``__main__``."""
