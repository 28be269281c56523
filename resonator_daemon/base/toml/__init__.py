"""TOML files to checked models: size limits before parsing, all findings with line and remedy."""
