"""What other programs have oriented, with tie points -> the tables of a free network."""
