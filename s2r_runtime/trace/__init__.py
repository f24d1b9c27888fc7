"""From the residual to the effect that a model lacks, and the error before and after."""
