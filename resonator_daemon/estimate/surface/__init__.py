"""From signals at depth back to what happens on the surface: maps, contacts, shape and slip."""
