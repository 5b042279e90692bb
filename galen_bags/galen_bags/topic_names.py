"""Names of topics, checked before rclpy rejects them in its own words."""

from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_topic_name import validate_topic_name

from galen_bags.errors import BagError


def check_topic_name(name: str) -> str:
    """Return `name`; raises BagError if no topic can have it."""
    try:
        validate_topic_name(name)
    except InvalidTopicNameException as error:
        reason = str(error).splitlines()[0].removeprefix("Invalid topic name: ").rstrip(":")
        raise BagError(f"{name!r} is no name of a topic: {reason}") from error
    return name
