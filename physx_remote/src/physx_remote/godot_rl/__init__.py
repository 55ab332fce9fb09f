"""The protocol of godot_rl_agents."""
