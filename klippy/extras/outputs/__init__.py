"""What output sections share: values at print times."""
