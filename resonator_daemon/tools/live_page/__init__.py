"""Live page: web server that relays what plates publish to browsers, and their commands and presses back."""
