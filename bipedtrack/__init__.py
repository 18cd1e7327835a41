"""Tracks commanded trunk and ankle motions with a bipedal robot: inverse kinematics plus a learned feedback.

How the data flow, and which module to read for it::

    curricula/*.toml -> curriculum -> training (brax PPO) -> checkpoint -> export -> policy.npz
                                         |                                              |
      tasks (one task step)              |            evaluate, play, video  <----------+
            |                            v                       |
            v                     env (MJX, jitted)              v  MuJoCo C, numpy only
      planner -> Command: I^s, I^t, dI^t/dt, T          eq (3)
            |       |
            |       +-> kinematics -> a_ff              eqs (2) (4) (5)
            v                          |
      observation eq (8) -> policy -> a_fb -> control   eqs (6) (7) -> PD -> physics
            ^                                              |
            +------ nodes (trunk, left ankle, right ankle) +-> rewards eqs (11)-(16)

Everything between a command and the joint targets is written once over the Array API standard: jax arrays
train it, numpy arrays run it on a robot. Units are SI; the frames are the world (``_w``) and the trunk's F_B
(``_b``).
"""

__version__ = "0.1.0"
