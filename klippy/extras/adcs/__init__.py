"""What the sections that offer analog pins (adc_scaled.py, ads1x1x.py) share."""
