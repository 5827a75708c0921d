#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How many robots one `vla serve` keeps moving, by simulation of its queue, and so how many servers a fleet needs.

    python3 scripts/fleet_size.py --service-ms 360 --horizon 50 --rate 30 --replan 25

Assumed: each robot asks at a steady interval (its replan rows at its rate) that jitters by 5 %, at a phase of its own, whether its last
answer came or not; the server computes one act at a time, in the order of arrival, and of a robot that asks again keeps the newest act in
the place of the waiting one; service times spread as a lognormal distribution; the network takes a fixed time. A robot is in time when
its chunk comes before the rows of the chunk before it run out. A fleet is robots spread evenly over servers that share nothing.
"""
import argparse
import heapq
import json
import math
import random

JITTER = 0.05
ACTS = 4000  # of all robots together, in one simulation


def simulate(n_robot, interval, service, spread, network=0.0, n_act=ACTS, seed=1, poisson=False):
    """Seconds from asking to the chunk of every act that was answered, the number of acts that newer ones replaced, and the server's
    utilization. `spread`: standard deviation over mean of the service time; `poisson`: robots ask at random and nothing is replaced, for comparison with theory."""
    draw = random.Random(seed)
    sigma = math.sqrt(math.log(1 + spread**2))
    asks = [(draw.random() * interval, robot) for robot in range(n_robot)]
    heapq.heapify(asks)
    waiting, order, free, busy, took, replaced = {}, [], 0.0, 0.0, [], 0
    for i in range(n_act):
        now, robot = heapq.heappop(asks)
        step = draw.expovariate(1 / interval) if poisson else interval * draw.gauss(1, JITTER)
        heapq.heappush(asks, (now + max(0.0, step), robot))
        while order and free <= now:  # the server has taken these up meanwhile
            first = order.pop(0)
            asked = waiting.pop(first)
            length = service * (draw.lognormvariate(-(sigma**2) / 2, sigma) if spread else 1.0)
            free, busy = max(free, asked) + length, busy + length
            took.append(free - asked + network)
        who = (robot, i if poisson else 0)
        if who in waiting:
            replaced += 1
        else:
            order.append(who)
        waiting[who] = now
    return took, replaced, busy / max(free, now)


def in_time(n_robot, a):
    """The share of acts whose chunk comes in time."""
    took, replaced, _ = simulate(n_robot, a.replan / a.rate, a.service_ms / 1e3, a.spread, a.network_ms / 1e3)
    limit = (a.horizon - a.replan) / a.rate
    return sum(t <= limit for t in took) / max(1, len(took) + replaced)


def robots_of_a_server(a):
    """The most robots of which the asked share of acts is in time; 0 where one is too many."""
    most = 0
    while in_time(most + 1, a) >= a.share:
        most += 1
    return most


def build_parser():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--service-ms", type=float, required=True, help="mean time of an act at the server: act_ms of vla doctor --json")
    parser.add_argument("--spread", type=float, default=0.05, help="standard deviation of that over the mean (default 0.05)")
    parser.add_argument("--horizon", type=int, required=True, help="rows of a chunk")
    parser.add_argument("--rate", type=float, required=True, help="rows a second")
    parser.add_argument("--replan", type=int, required=True, help="rows after which a robot asks again")
    parser.add_argument("--network-ms", type=float, default=5.0, help="both ways (default 5)")
    parser.add_argument("--share", type=float, default=0.99, help="of acts that must be in time (default 0.99)")
    parser.add_argument("--fleet", default="1,100,10000", help="robots, with commas (default 1,100,10000)")
    return parser


def main():
    parser = build_parser()
    a = parser.parse_args()
    if not (0 < a.replan < a.horizon and a.rate > 0 and a.service_ms > 0 and a.spread >= 0 and 0 < a.share <= 1):
        parser.error("expected 0 < replan < horizon, a rate and a time above 0, and a share up to 1")
    most = robots_of_a_server(a)
    fleets = {n: math.ceil(int(n) / most) if most else None for n in a.fleet.split(",")}
    print(json.dumps({"robots_of_a_server": most, "in_time": in_time(max(1, most), a), "in_time_with_one_more": in_time(most + 1, a), "servers": fleets}))


if __name__ == "__main__":
    main()
