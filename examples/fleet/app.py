#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A fleet of engines behind one address: Ray Serve starts, spreads, watches and replaces them.

    python app.py ../../models/metaworld-tiny.gguf --replicas 2 --most 4 --address 127.0.0.1:8000

Robots speak openpi's protocol at ws://127.0.0.1:8000/NAME. SIGTERM answers the acts under way, sends the robots away, and stops the engines.
"""

import argparse
import asyncio
import contextlib
import ipaddress
import os
import signal
import sys
import time

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray asks for it otherwise, and reports to its makers

import ray  # noqa: E402
from engine import Engine  # noqa: E402
from front import Front, Lost  # noqa: E402
from ray import serve  # noqa: E402
from ray.exceptions import RayError, RayTaskError  # noqa: E402
from ray.serve.config import AutoscalingConfig, RequestRouterConfig  # noqa: E402
from ray.serve.exceptions import BackPressureError, RayServeException  # noqa: E402
from ray.serve.experimental.consistent_hash_router import ConsistentHashRouter  # noqa: E402


@serve.deployment
class Replica:
    """One engine. Acts take turns, and Serve counts those that wait: that is the queue's depth."""

    def __init__(self, *engine) -> None:
        self._engine = Engine(*engine)
        self._turn = asyncio.Lock()

    async def greeting(self) -> bytes:
        return self._engine.greeting()

    async def act(self, message):
        asked = time.perf_counter()
        async with self._turn:
            queue_ms = 1e3 * (time.perf_counter() - asked)
            return await asyncio.to_thread(self._engine.act, message, queue_ms)  # health is answered meanwhile


class Engines:
    """The replicas as the front asks them: a robot's acts go to one of them as long as it lives and has room."""

    def __init__(self, handle) -> None:
        self._handle = handle

    async def greet(self, robot):
        return await self._ask(robot, "greeting")

    async def act(self, robot, message):
        return await self._ask(robot, "act", message)

    async def _ask(self, robot, method, *arguments):
        """An act is a function of its observation, so one whose replica died is asked for again: once, because it may be what
        killed it. Errors: Lost."""
        replica = self._handle.options(session_id=robot, method_name=method)
        for _ in range(2):
            try:
                return await replica.remote(*arguments)
            except BackPressureError:
                return "busy: the queue: expected room, found none"
            except RayTaskError as problem:  # a fault of ours; refusals are answers
                return f"internal: {robot}: {problem.cause!r}"
            except (RayError, RayServeException) as problem:
                died = type(problem).__name__
        raise Lost(f"two replicas failed ({died})")


def deployed(args):
    """The handle of the replicas, once they are ready."""
    queue = AutoscalingConfig(
        min_replicas=args.replicas,
        max_replicas=max(args.most, args.replicas),
        target_ongoing_requests=args.queue,
        upscale_delay_s=5,  # loading a policy takes longer than a burst
        downscale_delay_s=args.calm,
    )
    options = Replica.options(
        autoscaling_config=queue,
        max_ongoing_requests=max(8, int(2 * args.queue)),  # at one replica; then its robots' acts go to the next one
        max_queued_requests=args.connections,
        request_router_config=RequestRouterConfig(request_router_class=ConsistentHashRouter),
        health_check_period_s=1,  # after which a dead one is missed
        ray_actor_options={"num_cpus": args.threads},
        logging_config={"log_level": "WARNING", "enable_access_log": False},
    )
    application = options.bind(os.path.abspath(args.bundle), args.map, args.threads, args.kernels)
    return serve.run(application, name="vla", route_prefix=None)


async def answer(args, handle):
    """Until SIGTERM or Ctrl-C."""
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopped.set)
    engines = Engines(handle)
    front = Front(engines.greet, engines.act, args.connections)
    host, port = args.address
    async with front.listen(host, port) as server:
        port = server.sockets[0].getsockname()[1]
        print(f"ready address=ws://{host}:{port} replicas={args.replicas} pid={os.getpid()}", flush=True)
        await stopped.wait()
        await front.drain()


def address(text):
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise argparse.ArgumentTypeError(f"expected ADDRESS:PORT, found {text}")
    return host, int(port)


def is_local(host):
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("bundle", help="the policy, at the same path on every machine")
    parser.add_argument("--map", action="append", metavar="KEY=NAME", help="a key of the robots for a view or state of the policy, or `text`")
    parser.add_argument("--threads", type=int, default=1, help="of each engine (default 1)")
    parser.add_argument("--kernels", help="as in vla serve")
    parser.add_argument("--replicas", type=int, default=2, help="the fewest engines (default 2)")
    parser.add_argument("--most", type=int, default=2, help="the most engines (default 2)")
    parser.add_argument("--queue", type=float, default=2.0, help="acts at an engine, the computed one too, from which on there should be more engines (default 2)")
    parser.add_argument("--calm", type=float, default=60.0, help="seconds of little to do before an engine goes (default 60)")
    parser.add_argument("--connections", type=int, default=1024, help="robots at once (default 1024)")
    parser.add_argument("--address", type=address, default="127.0.0.1:8000", help="where robots connect (default 127.0.0.1:8000; port 0: a free one)")
    parser.add_argument("--insecure", action="store_true", help="allow an address that other machines reach: there are no keys")
    parser.add_argument("--cluster", help="of a Ray cluster that runs, e.g. auto; not given: one is started here")
    args = parser.parse_args()
    if not is_local(args.address[0]) and not args.insecure:
        parser.error(f"--address {args.address[0]}: expected a local address, found one that other machines reach; --insecure lets everybody in")
    return args


def main():
    args = arguments()
    ray.init(args.cluster, log_to_driver=False, **({} if args.cluster else {"include_dashboard": False}))
    serve.start(proxy_location="Disabled")  # robots talk to the front, so there is no HTTP proxy between
    try:
        asyncio.run(answer(args, deployed(args)))
    finally:
        serve.delete("vla")
    return 0


if __name__ == "__main__":
    sys.exit(main())
