"""Models of heat that sensing, control, identification and planning share. They know none of them."""
