"""Are the columns what they say? Units, clocks and model order, tested by prediction error."""
