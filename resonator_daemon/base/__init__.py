"""What all other layers use: errors, reasons, conditions, the computer, TOML files, the plate."""
