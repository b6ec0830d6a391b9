"""The block service: hands out stored blocks over HTTP without ever decoding them."""
