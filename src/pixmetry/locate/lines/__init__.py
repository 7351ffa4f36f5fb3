"""Lines, crosses and edges."""
