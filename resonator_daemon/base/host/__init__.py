"""Interfaces to the computer: directories, journal, systemd, atomic files, text for terminals."""
