"""The protocol of godot_rl_agents: service and client."""
