"""Training of an actor by reinforcement learning: the paper's DDPG, TD3, and PPO with many cars.

`ddpg` follows the paper in its state, reward, ends of an episode, exploration (Gaussian noise of
0.05 beta on an action, with a probability that falls from 1 to 0.1 over 4*10^5 steps), noise of
0.05 on the state, discount of 0.99, Adam, replay and soft targets. The action joins the critic's
last hidden layer, as in the paper. Deviations from the paper, and settings that it does not state:

- The hidden layers have 64 units each; the paper gives sizes only in a figure.
- The learning rates are 1e-4 (actor) and 3e-4 (critic), the batch is 64 and tau is 0.001, as in the
  authors' released settings. The paper states learning rates of 1e-3 and 1e-4, which are given by
  `--actor-rate 1e-3 --critic-rate 1e-4`.
- beta is 4, so the noise on an action has a standard deviation of 0.2. The replay keeps all steps.
- The first 1000 steps only fill the replay.
- `w` is half the width of the track, as in the environment's reward. Other drives divide the offset
  by the `w` of the training, because a controller does not know the width of the road.
- The drives use the target actor, an average over the last updates. The actor with the best drive
  on the training track is saved.

`td3` has further differences: two critics, target noise of 0.02, an update of the actor after every
second update of the critics, no noise on the state, discount of 0.95, tau of 0.005, learning rates
that fall to 5 %. Its reward is 4 (r - 1), where r is the paper's reward; in all steps after a
terminal state r is 0. The optimal policy is the same. The inputs of its networks are divided by
their typical spread. Left and right are exchanged in half of the transitions, and the actor is odd
by construction. Its episodes have 400 steps; nine of ten begin at a random place with a random
motion.

`ppo` (`controllers.rl.ppo`) always drives many cars, on all tracks and random roads. `ddpg` and
`td3` can also drive many cars (`--envs 256`). Then an update has 256 transitions, and there is one
update for eight control steps, summed over all cars; the agent is the same.

The paper's state contains neither the curvature of the road nor the yaw rate. `--state stacked`
adds the yaw rate, the changes since the last step and the last two actions. `--state residual` also
adds the steering of the controller `lqr`, which the actor's action corrects. `--state history` has
the paper's state of the last eight steps.
"""
