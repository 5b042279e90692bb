"""Speed, endurance and long validation; not installed."""
