"""TOML files into checked models: bounded before they are parsed, every finding with its line and advice."""
