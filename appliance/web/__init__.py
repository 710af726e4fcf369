"""What is served over HTTP. `net/http.py` is the protocol, and `app/web.py` has the parts."""
