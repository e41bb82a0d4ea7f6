"""Networks. The axis names of every shape in the package:

batch       samples computed together
height      rows of a picture, in pixels
width       columns of a picture, in pixels
tokens      cells of the feature map, row by row: 64 for a 128 x 128 picture
channels    channels of the backbone's feature map, 256
dim         channels D of tokens, slots and FiLM, 42
slots       learnable slot queries N_s
queries     queries of one attention, slots or anything else
rows        heads times queries, the queries of one head side by side
heads       attention heads
head_dim    channels of one head, dim / heads
stacked     heads times dim, the averaged tokens of all heads side by side
objects     objects whose projected positions supervise the slots, N_o
assignments one-to-one assignments of objects to slots
frames      frames of a data set
proprio     the state vector
latent      what actor and critics read
action      dimensions of an action
"""
