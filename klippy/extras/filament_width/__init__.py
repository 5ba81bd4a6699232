"""What the sensors of the filament's width share.

ADC pins ──► diameter ──► queue along the filament (delay.py) ──► flow factor of M221 (compensation.py)
"""
