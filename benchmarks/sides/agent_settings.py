"""Settings of the peers' IQL and BC, equal to those of `wm_iql` and `wm_bc`."""

OBSERVATION_DIM = 512 + 6 + 4  # latent, one-hot task, proprioception
ACTION_DIM = 4
HIDDEN_DIMS = [256, 256]
DROPOUT = 0.1
LEARNING_RATE = 3e-4
BETA = 0.5
EXPECTILE = 0.7
DISCOUNT = 0.99
TARGET_RATE = 0.005
