"""C files of plans and laws."""
