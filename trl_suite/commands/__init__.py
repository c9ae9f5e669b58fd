"""What stands behind the longer commands of `trl-suite`: doctor, bench and gallery."""
