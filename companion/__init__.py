"""An offboard companion for PX4: flies a multirotor along a trajectory with an adaptive backstepping tracker."""

__version__ = "0.1.0"
