"""The engine Pinocchio: integration, contacts, and constraint solver."""
