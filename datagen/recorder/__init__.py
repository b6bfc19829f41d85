"""Records one round (simulates, renders and writes it), and simulates recorded rounds again."""
