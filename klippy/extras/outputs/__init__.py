"""What outputs share: pins that change at print times, and files that commands write."""
