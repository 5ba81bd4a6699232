"""What templates of G-code macros are run in."""
