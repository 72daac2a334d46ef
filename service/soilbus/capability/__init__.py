"""What a soil lets the vehicle do, with standard deviations: pull, grade, slip, sinkage, torque."""
