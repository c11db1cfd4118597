"""The completion network: dense depth from a scan's sparse depth and the image, trained on rendered worlds alone."""
