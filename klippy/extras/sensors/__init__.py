"""What temperature sensors share: the table of their types, and the chips on I2C."""
