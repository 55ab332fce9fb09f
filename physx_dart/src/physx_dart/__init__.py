"""physx plugins `dart` and `pinocchio`: simulations of robots, and environments with them."""
