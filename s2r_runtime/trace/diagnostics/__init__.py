"""What is left in a fitted model: lack of fit, constancy, detectability, rollout error."""
