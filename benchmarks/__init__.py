"""Speed, memory and compile time, measured and recorded."""
