"""What is written and shown: the reconstruction's folder and formats, pictures, recordings."""
