"""What one looks at: frames, videos, film strips, plots, windows."""
