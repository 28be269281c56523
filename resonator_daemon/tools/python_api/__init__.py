"""What `import resonatord` offers: recordings as tables, messages as they come, commands."""
