"""NeuSpring: spring-mass twins of deformable objects from RGBD video, as an open, workflow-orchestrated platform."""

__version__ = "0.2.0"
