"""The link to one MCU: its serial port, its clock against ours, its session, its pins and triggers."""
