"""What all other layers use: errors, reasons, states, the computer, TOML files, the plate."""
