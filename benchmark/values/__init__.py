"""How far a critic's values lie above the returns that follow."""
