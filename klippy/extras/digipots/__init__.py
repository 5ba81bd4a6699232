"""What the sections of digital potentiometers and DACs (ad5206.py, mcp4018.py, ...) share."""
