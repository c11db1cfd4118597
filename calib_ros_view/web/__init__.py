"""Pages in the browser. NiceGUI brings all that they need with its wheel: they work without the internet."""
