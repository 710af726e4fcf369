"""A robot of ROS 1: publishes strings on /chatter and prints those that it hears on /hear."""

import time

import rosgraph
import rospy
from std_msgs.msg import String

while not rosgraph.is_master_online():  # without one, rospy says so where the strings are printed
    time.sleep(0.1)
rospy.init_node("robot")
publisher = rospy.Publisher("/chatter", String, queue_size=1)
rospy.Subscriber("/hear", String, lambda message: print(message.data, flush=True))
clock = rospy.Rate(5)
while not rospy.is_shutdown():
    publisher.publish("from the robot")
    clock.sleep()
