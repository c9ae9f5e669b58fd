"""Tasks that go to places in three dimensions."""
