"""The report of a training: an HTML page with diagrams, and pictures for papers."""
