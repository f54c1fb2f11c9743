"""ROS 2's wire without ROS: DDS participant, topics by role in, poses out, and recordings played."""
