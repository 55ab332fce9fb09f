"""The protocol of godot_gym_api: service and client."""
