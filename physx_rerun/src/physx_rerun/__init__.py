"""physx plugin `rerun`: shows environments and training in the Rerun viewer."""
