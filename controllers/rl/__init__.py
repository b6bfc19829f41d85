"""Steering learnt by reinforcement: the paper's DDPG, and TD3 as the stronger yardstick.

`ddpg` follows the paper: its state, reward, ends, exploration (Gaussian noise of 0.05 beta on an
action with a probability that falls from 1 to 0.1 over 4*10^5 steps), noise of 0.05 on the state,
discount 0.99, Adam, a replay, soft targets, the action joined to the critic's last hidden layer.
Deviations from the paper, and settings where it is silent:

- The sizes of the layers stand in a figure that the text does not repeat: 64 and 64 here.
- Learning rates 1e-4 (actor) and 3e-4 (critic), batch 64, tau 0.001: the authors' released
  settings. The paper gives 1e-3 and 1e-4: `--actor-rate 1e-3 --critic-rate 1e-4`.
- beta is 4, so the noise on an action has the standard deviation 0.2; the replay holds all steps.
- The first 1000 steps only fill the replay.
- `w` is half the width of the track, as in the environment's reward. In other drives the offset is
  divided by that of the track trained on: a controller does not know the road's width.
- What drives is the target actor, an average over the last updates, taken at the best of the drives
  on the training track.

`td3` differs further: two critics, target noise 0.02, an actor updated every second time; no noise
on the state; discount 0.95, tau 0.005, learning rates that fall to 5 %; a constant of 1 subtracted
from the reward (after an end, too, so the optimal policy stays the same) and the rest times 4;
networks' inputs divided by their typical spread; left and right exchanged in half of the
transitions and an actor that is odd by construction; episodes of 400 steps from random places and
motions.

The paper's state holds neither the curvature nor the yaw rate. With `--state stacked` the actor
also sees the yaw rate, the changes since the last step and its last two actions; with `--state
residual` it also sees the steering of the controller `lqr`, and its own action is added to that.
"""
