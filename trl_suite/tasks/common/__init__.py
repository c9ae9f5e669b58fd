"""Components that several tasks share."""
