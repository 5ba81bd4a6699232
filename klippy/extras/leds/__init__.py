"""What the sections of LEDs on a bus (dotstar.py, pca9533.py, pca9632.py) share."""
