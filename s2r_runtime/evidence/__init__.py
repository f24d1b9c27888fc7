"""What is stated of a robot, and on which data: samples, gap, verification, the watch and their bounds."""
