"""The Galen's geometry, kinematics, stiffness and URDF."""
