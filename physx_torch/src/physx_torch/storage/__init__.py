"""Parameter and state files in the safetensors format."""
