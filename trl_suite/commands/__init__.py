"""The commands of `trl-suite`, one module each; and what several of them need."""
