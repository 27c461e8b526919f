"""A package with published figures, as a method's package has them beside its modules."""
