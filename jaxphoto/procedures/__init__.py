"""Procedures: complete workflows that combine the packages below, a module each."""
