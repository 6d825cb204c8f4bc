"""Procedures: short scripts that combine the packages below, a module each."""
