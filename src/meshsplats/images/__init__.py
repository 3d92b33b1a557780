"""Image files: reading them with limits, writing them, and images side by side."""
