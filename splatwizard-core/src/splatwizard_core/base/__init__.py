"""Plain tools that know no room."""
