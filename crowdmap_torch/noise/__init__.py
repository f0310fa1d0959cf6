"""What sensors get wrong: poses and pixels."""
