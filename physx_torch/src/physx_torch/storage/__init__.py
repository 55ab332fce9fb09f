"""Parameter and state files in safetensors."""
