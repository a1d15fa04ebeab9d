"""What the designer says: coordinates, bodies, mechanisms, programs, paths."""
