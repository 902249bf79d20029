"""What happens: the arm, its drives, the cell's I/O and the motion host, on an emulated bus."""
