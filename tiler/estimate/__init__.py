"""What a build would make and take, without making it."""
