"""What the computer gives and wants: directories, the journal, systemd, whole files, text for terminals."""
