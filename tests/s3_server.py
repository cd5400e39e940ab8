"""An S3 server on loopback: ``python -m tests.s3_server PORT``.

One request at a time: S3 decides about a conditional one in one step; moto's threads look first and write later.
"""

import sys
import threading
from collections.abc import Iterable

from moto.server import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import run_simple

ONE = threading.Lock()
answer = DomainDispatcherApplication(create_backend_app)


def one_at_a_time(environment: dict, start_response) -> Iterable[bytes]:
    """Answer a request as moto does, but never two at once."""
    with ONE:
        return list(answer(environment, start_response))


if __name__ == "__main__":
    run_simple("127.0.0.1", int(sys.argv[1]), one_at_a_time, threaded=True, request_handler=MotoRequestHandler)
