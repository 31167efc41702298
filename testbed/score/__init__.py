"""What a record is worth: errors against truth, consistency, observability."""
